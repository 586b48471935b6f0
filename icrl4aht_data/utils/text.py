"""Numbers with nouns, lists of names, Markdown tables, and files and templates of the `cards` folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import RESTORE

_PACKAGE = Path(__file__).parent.parent


def counted_noun(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun in the singular or plural; the default plural adds an s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def counted_histories(number: int) -> str:
    """Return a number of histories as text, such as "1 history" or "2,000 histories"."""
    return counted_noun(number, "history", "histories")


_LISTED = 10  # length of the longest list of names that is shown completely


def listed_names(names: Sequence[str]) -> str:
    """Return a list of names as text. A long list is shortened, for example to "a, b and 198 others"."""
    if len(names) <= _LISTED:
        return ", ".join(names)
    return f"{', '.join(names[: _LISTED - 1])} and {len(names) - _LISTED + 1} others"


def card_file(name: str) -> Path:
    """Return the path of a file of the folder `cards`, or of LICENSE or CITATION.cff.

    An installed package contains the folder `cards`. In a checkout, `cards` is next to the package, and LICENSE and
    CITATION.cff are in the root.

    Args:
        name: file name.

    Raises:
        OptionError: if the file is missing.
    """
    for folder in (_PACKAGE / "cards", _PACKAGE.parent / "cards", _PACKAGE.parent):
        if (folder / name).is_file():
            return folder / name
    raise OptionError(f"{_PACKAGE / 'cards' / name}: missing; restore it: `{RESTORE}`")


def fill_template(template: str, **values: str) -> str:
    """Return the text of a template in the folder `cards`, with every $name replaced by a value.

    Raises:
        KeyError: if the value for a name is missing.
    """
    return Template(card_file(template).read_text(encoding="utf-8")).substitute(values)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: int = 0) -> str:
    """Return a Markdown table; the last `right` columns are aligned to the right."""
    rule = "|" + "---|" * (len(header) - right) + "---:|" * right
    lines = [f"| {' | '.join(cells)} |" for cells in (header, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]])
