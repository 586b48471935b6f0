"""Files and templates of the `cards` folder, and Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import RESTORE

_PACKAGE = Path(__file__).parent.parent


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
    """Return a Markdown table whose last `right` columns are right-aligned."""
    rule = "|" + "---|" * (len(header) - right) + "---:|" * right
    lines = [f"| {' | '.join(cells)} |" for cells in (header, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]])
