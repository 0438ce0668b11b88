"""Damaged files of every layout end in a plausible sequence or in one line that names the file,
never in anything else.

A short recording is written once per layout; each example copies it and does to one or two of its
files what copying, editing, converting or an attacker may do to them. What was wrong once is in
`readers/test_bad_files.py`.
"""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.damage import damages
from tests.support.damaged_recordings import check, written
from tests.support.layouts import LAYOUTS

FEW = 6
"""Examples of every layout among the quick tests."""
EXAMPLES = {"tyrex Nexus": 24, "tyrex iPhone": 24, "oxiod Tango": 8}
EXAMPLES |= dict.fromkeys(("oxiod raw", "oxiod syn", "oxiod Nexus"), 12)
EXAMPLES |= dict.fromkeys(("idol", "euroc", "tumvi", "kitti packets"), 40)
"""Among the slow tests, of the slower layouts; 60 of the others."""


@pytest.mark.parametrize("few", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_damaged_recording_is_plausible_or_refused_by_name(name, few):
    one = damages(list(LAYOUTS[name].targets or written(name)))

    @settings(
        max_examples=FEW if few else EXAMPLES.get(name, 60),
        derandomize=True,
        database=None,
        deadline=None,  # `check` has one of its own
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(one, min_size=1, max_size=2))
    def run(happened):
        check(name, happened)

    run()
