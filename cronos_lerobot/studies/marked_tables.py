"""Tables of a page that are made from files and stand between two marks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class MarkedTable:
    """Where a table stands."""

    name: str
    page: Path
    module: str
    """That makes it, by `python -m`."""

    @property
    def begin(self) -> str:
        """The mark before it."""
        return f"<!-- {self.name}: made by python -m {self.module} -->"

    @property
    def end(self) -> str:
        """The mark behind it."""
        return f"<!-- end of {self.name} -->"

    def rewrite(self, text: str, table: str) -> str:
        """A page's text with the table made anew.

        Raises:
            ValueError: it has not the marks.
        """
        if text.count(self.begin) != 1 or text.count(self.end) != 1:
            raise ValueError(f"the page must have {self.begin} and {self.end} once each")
        head, rest = text.split(self.begin)
        return f"{head}{self.begin}\n{table}\n{self.end}{rest.split(self.end)[1]}"


def main(marked: MarkedTable, make: Callable[[], str], description: str | None) -> None:
    """Write the page anew, or say whether it is up to date."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        prog=f"python -m {marked.module}",
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if it is not up to date")
    args = parser.parse_args()
    before = marked.page.read_text()
    after = marked.rewrite(before, make())
    if not args.check:
        marked.page.write_text(after)
    elif after != before:
        sys.exit(f"{marked.page} is not what the files say: run it without --check")
