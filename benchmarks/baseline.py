"""The recorded figures of the benchmarks, and the comparison with a new run.

`baseline.json` holds for each figure the value that was measured and a limit. A value beyond the
limit counts as worse.
"""

import json
from pathlib import Path

FILE = Path(__file__).with_name("baseline.json")


def compare(benchmark: str, figures: dict[str, float]) -> bool:
    """Print each figure beside its baseline. Return True if every figure is within its limit.

    A limit is "at most" or "at least". Figures without a baseline are not printed.
    """
    recorded = json.loads(FILE.read_text())[benchmark]
    all_fine = True
    print(f"\n{benchmark} against {FILE.name} ({recorded['machine']}):")
    for name, value in figures.items():
        if name not in recorded["figures"]:
            continue
        entry = recorded["figures"][name]
        limit = "at most" if "at most" in entry else "at least"
        fine = value <= entry[limit] if limit == "at most" else value >= entry[limit]
        verdict = "fine" if fine else "WORSE"
        bounds = f"was {entry['was']:,.3g}, {limit} {entry[limit]:,.3g}"
        print(f"  {name}: {value:,.3g}, {bounds}: {verdict}")
        all_fine &= fine
    return all_fine
