"""Training: losses, optimizer, two tasks with their jitted steps, one loop, checkpoints.

`training.loop.train(config)` trains a run, `training.checkpoint.load_run(workdir)` loads one. The
modules are imported by name, since Orbax takes seconds to import.
"""
