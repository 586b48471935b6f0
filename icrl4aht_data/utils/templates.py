"""The project's `cards` folder: where its files are, and how templates and tables are filled."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template

from icrl4aht_data.errors import OptionError

_PACKAGE = Path(__file__).parent.parent


def card_file(name: str, package: Path = _PACKAGE) -> Path:
    """A template, table, licence or citation by its file name.

    In an installed package all of them are in its folder `cards`; in a checkout in `cards` beside the package, but for
    LICENSE and CITATION.cff, which are beside that.

    Args:
        package: the folder of the package.

    Raises:
        OptionError: if there is none.
    """
    for folder in (package / "cards", package.parent / "cards", package.parent):
        if (folder / name).is_file():
            return folder / name
    raise OptionError(f"{package / 'cards' / name}: missing; install icrl4aht-data again")


def fill(template: str, **values: str) -> str:
    """The text of a template of the folder `cards`, every $name replaced.

    Raises:
        KeyError: if a value is missing.
    """
    return Template(card_file(template).read_text(encoding="utf-8")).substitute(values)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: int = 0) -> str:
    """A Markdown table; its last `right` columns are aligned to the right."""
    rule = "|" + "---|" * (len(header) - right) + "---:|" * right
    return "\n".join([_row(header), rule, *map(_row, rows)])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
