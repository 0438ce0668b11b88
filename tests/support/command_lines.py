"""The command lines of `gnio`, as far as they are read."""

from gnio_jax.commands import app, options


def commands(group=app.GNIO, words=()):
    """(words, function) of every command: ("data", "check"), ..."""
    for name, command in group.commands.items():
        if isinstance(command, options.Group):
            yield from commands(command, (*words, name))
        else:
            yield (*words, name), options.function(command)


def run(*words):
    """`gnio WORDS`, without the exit status: mistakes are raised."""
    options.run(app.GNIO, options.Call("gnio", words))


def understood(words):
    """The options of `gnio WORDS`, which does not run. Raises `InputError` for mistakes."""
    command = next(entry for entry in commands() if tuple(words[: len(entry[0])]) == entry[0])
    call = options.Call(" ".join(["gnio", *command[0]]), words[len(command[0]) :])
    return options.read(command[1], call)
