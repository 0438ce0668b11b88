"""The figures that benchmarks are held against: `baseline.json`, each with the limit beyond which
it counts as worse."""

import json
from pathlib import Path

FILE = Path(__file__).with_name("baseline.json")


def compare(benchmark: str, figures: dict[str, float]) -> bool:
    """Print each figure beside its baseline; True if none is worse than its limit ("at most" or "at
    least")."""
    recorded = json.loads(FILE.read_text())[benchmark]
    fine = True
    print(f"\n{benchmark} against {FILE.name} ({recorded['machine']}):")
    for name, value in figures.items():
        if name not in recorded["figures"]:
            continue
        entry = recorded["figures"][name]
        good = value <= entry["at most"] if "at most" in entry else value >= entry["at least"]
        limit = "at most" if "at most" in entry else "at least"
        print(
            f"  {name}: {value:,.3g}, was {entry['was']:,.3g}, {limit} {entry[limit]:,.3g}: {'fine' if good else 'WORSE'}"
        )
        fine &= good
    return fine
