"""The code of a page runs as it stands there."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_the_loop_of_ones_own(capsys):
    """A quarter of its piece and of its steps."""
    (code,) = re.findall(
        r"```python\n(.*?)```", (DOCS / "differentiable_filter.md").read_text(), re.S
    )
    assert "20 * 100" in code and "range(20)" in code
    exec(code.replace("20 * 100", "20 * 25").replace("range(20)", "range(5)"), {})
    losses = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 5 and losses[-1] < losses[0]
