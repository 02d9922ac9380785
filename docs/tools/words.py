"""Words of the pages that people write, page by page and all of them.

``python docs/tools/words.py`` prints them. Counted is what stands between blanks and
holds a letter or a digit, code and tables too; what the site generates (API, commands,
configuration, printed results) is not.
"""

from __future__ import annotations

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[2]


def counted() -> dict[str, int]:
    """Words of each page, by its path."""
    pages = [
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("examples/*.md"),
        *ROOT.glob("*.md"),
    ]
    return {
        str(page.relative_to(ROOT)): sum(
            bool(re.search(r"\w", word)) for word in page.read_text("utf-8").split()
        )
        for page in sorted(pages)
    }


if __name__ == "__main__":
    found = counted()
    for name, count in found.items():
        print(f"{count:6,}  {name}")
    print(f"{sum(found.values()):6,}  words, {len(found)} pages")
