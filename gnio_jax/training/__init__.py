"""Training: losses, optimizer, two tasks with their jitted steps, one loop, checkpoints.

`training.loop.train(config)` trains a run. Its best weights and its settings are a network that
`networks.load` reads. The modules are imported by name, since Orbax takes half a second to import.
"""
