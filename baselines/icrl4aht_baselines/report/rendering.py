"""Filling the templates of the report's page."""

from __future__ import annotations

import base64
import traceback
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrl4aht_baselines.report.overlap import overlap_marks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import RESTORE, install_command

if TYPE_CHECKING:
    from jinja2 import Environment, Template

_TEMPLATES = Path(__file__).parent / "templates"
_FILES = ("page.html", "page.css", "charts.html", "tables.html")


def check_can_render() -> None:
    """Check, before work that ends in a page, that pages can be made.

    Raises:
        OptionError: if Jinja2 or a template is missing.
    """
    environment = _environment()
    for name in _FILES:
        _load(environment, name)


def render(name: str, values: dict[str, Any]) -> str:
    """Returns a template filled with values, which are escaped for HTML.

    Args:
        name: file in the folder `templates`.
        values: name -> value.

    Raises:
        OptionError: if Jinja2 or a template is missing, or a template uses a value that was not passed.
    """
    from jinja2 import UndefinedError

    template = _load(_environment(), name)
    try:
        return template.render(values)
    except UndefinedError as error:
        frames = traceback.extract_tb(error.__traceback__)
        where = [frame for frame in frames if Path(frame.filename).parent == _TEMPLATES][-1]
        raise OptionError(
            f"{where.filename}, line {where.lineno}: {error.message}, expected a value of the page; restore the "
            f"templates: `{RESTORE}`"
        ) from error


def _load(environment: Environment, name: str) -> Template:
    from jinja2 import TemplateNotFound, TemplateSyntaxError

    try:
        return environment.get_template(name)
    except TemplateNotFound as error:
        raise OptionError(f"{_TEMPLATES / name}: missing; restore it: `{RESTORE}`") from error
    except TemplateSyntaxError as error:
        raise OptionError(
            f"{error.filename}, line {error.lineno}: {error.message}; restore the template: `{RESTORE}`"
        ) from error


@cache
def _environment() -> Environment:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise OptionError(f"a page of results needs jinja2: {install_command('baselines')}") from error
    try:
        loader = PackageLoader("icrl4aht_baselines.report")
    except ValueError as error:
        raise OptionError(f"{_TEMPLATES}: missing; restore it: `{RESTORE}`") from error
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": _number, "signed": _signed, "picture": embed_picture, "marks": overlap_marks}
    return environment


def _number(value: float, digits: int = 1) -> str:
    return f"{value:z.{digits}f}"


def _signed(value: float, digits: int = 1) -> str:
    return f"{value:+z.{digits}f}"


def embed_picture(path: Path) -> str:
    """Returns a data URI with the content of a picture.

    Raises:
        OptionError: if there is no such file.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise OptionError(
            f"{path}: missing, expected a picture for the page; draw it again, or make the page without episodes "
            f"(--no-gifs)"
        ) from error
    return f"data:image/{path.suffix.removeprefix('.')};base64,{base64.b64encode(content).decode()}"
