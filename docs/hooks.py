"""Renders the notebooks as pages of the documentation; mkdocs.yml names this file."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook, next to the notebook itself."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text = Path(str(file.abs_src_path)).read_text(encoding="utf-8")
        page = file.src_uri.replace(".ipynb", ".md")
        files.append(File.generated(config, page, content=notebook_markdown(json.loads(text), file.name)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to notebooks lead to their pages."""
    return re.sub(r"\]\(([\w/]+)\.ipynb\)", r"](\1.md)", markdown)


def notebook_markdown(notebook: dict[str, Any], name: str) -> str:
    """Return a notebook with its outputs as Markdown, and a link to the file at the end."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += [_output(output) for output in cell.get("outputs", [])]
    link = f'<a href="{name}.ipynb" download>Download this notebook</a>'
    return "\n\n".join([*parts, link]) + "\n"


def _output(output: dict[str, Any]) -> str:
    data = {name: "".join(content) for name, content in output.get("data", {}).items()}
    for kind in ("image/png", "image/gif"):
        if kind in data:
            return f'<img alt="output of the cell" src="data:{kind};base64,{data[kind].strip()}">'
    if "text/html" in data:
        return f"<div>{data['text/html']}</div>"
    return f"```text\n{data.get('text/plain') or ''.join(output['text'])}\n```"
