"""What a user is told of a file that cannot be read."""

import pytest

from gnio_jax.errors import InputError


def refused(read, place, *words):
    """`read()` is refused in one line that begins with `place` and holds `words`."""
    with pytest.raises(InputError) as caught:
        read()
    text = str(caught.value)
    assert text.startswith(f"{place}: ") and "\n" not in text, text
    assert all(word in text for word in words), text
