"""The script that asks the pages' external links; no network is asked here."""

import importlib.util
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "scripts" / "external_links.py"


def test_what_is_no_address_is_a_problem_and_no_traceback():
    spec = importlib.util.spec_from_file_location("external_links", SCRIPT)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert "PORT" in script.problem("http://localhost:PORT/")
    assert script.problem("https://[half")
    assert script.links()
