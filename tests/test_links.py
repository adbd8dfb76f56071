"""Links of the pages lead to files and headings that are there."""

import re
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = ("*.md", "docs/*.md", "docs/results/**/*.md", "envs/**/README.md", "policies/**/README.md")
"""Not the templates of cards, whose links are of the repositories that they are for."""


def prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Those that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in plain}


def test_links_lead_somewhere():
    broken, seen = [], 0
    for page in chain(*(ROOT.glob(pattern) for pattern in PAGES)):
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            path, _, anchor = link.partition("#")
            if "://" in link:
                continue
            seen += 1
            target = page.parent / path if path else page
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert seen > 50
    assert not broken
