"""What a user is told of a file that cannot be read."""

import pytest

from gnio_jax.errors import InputError


def refused(read, subject, *words):
    """`read()` is refused in one line that begins with `subject` and holds `words`."""
    with pytest.raises(InputError) as caught:
        read()
    text = str(caught.value)
    assert text.startswith(f"{subject}: ") and "\n" not in text, text
    assert all(word in text for word in words), text
