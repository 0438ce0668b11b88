"""Asks every external link of the pages whether it is still there. Run by hand; needs a network.

python scripts/external_links.py           (ask, and show those that do not answer)
python scripts/external_links.py --list    (only list them)
"""

import re
import sys
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPException
from pathlib import Path

ROOT = Path(__file__).parents[1]
URL = re.compile(r"https?://[^\s)>\"'`\]]+")
EXAMPLES = ("https://github.com/gnio-jax/gnio-jax",)
"""Addresses of this repository, and what only stands for an address."""


def pages():
    """The Markdown that people read."""
    return [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def links():
    """URL -> the pages that have it."""
    pages_of = {}
    for page in pages():
        for url in URL.findall(page.read_text(encoding="utf-8")):
            url = url.rstrip(".,;:")
            if not url.startswith(EXAMPLES):
                pages_of.setdefault(url, []).append(page.relative_to(ROOT).as_posix())
    return pages_of


def problem(url):
    """Why a link does not answer; empty if it does."""
    agent = {"User-Agent": "Mozilla/5.0 (link check)"}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=agent), timeout=20):
            return ""
    except urllib.error.HTTPError as error:
        # Some sites refuse programs, not people.
        return "" if error.code in (403, 405, 429) else f"status {error.code}"
    except (OSError, HTTPException, ValueError) as error:  # ValueError: it is no address
        return str(error)


def main():
    pages_of = links()
    if "--list" in sys.argv:
        print("\n".join(sorted(pages_of)))
        return
    with ThreadPoolExecutor(8) as pool:
        problems = dict(zip(pages_of, pool.map(problem, pages_of), strict=True))
    failed = {url: why for url, why in problems.items() if why}
    for url, why in failed.items():
        print(f"{url}: {why} ({', '.join(pages_of[url])})")
    print(f"{len(pages_of)} links, {len(failed)} without an answer")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
