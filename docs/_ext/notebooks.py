"""Pages from notebooks: their text, their code and the outputs that are stored in them. Nothing is executed."""

from __future__ import annotations

import json
from typing import Any

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx


class NotebookParser(MystParser):
    """Parser of ``.ipynb`` files."""

    supported = ("ipynb",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        super().parse(to_markdown(inputstring), document)


def to_markdown(notebook: str) -> str:
    """The text (MyST) of a notebook (JSON)."""
    return "\n\n".join(part for cell in json.loads(notebook)["cells"] for part in _parts(cell))


def _parts(cell: dict[str, Any]) -> list[str]:
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [text]
    return [_fenced("python", text), *(part for output in cell["outputs"] for part in _shown(output))]


def _shown(output: dict[str, Any]) -> list[str]:
    if output["output_type"] == "stream":
        return [_fenced("text", "".join(output["text"]))]
    picture = output.get("data", {}).get("image/png")
    if picture is None:
        return []
    data = "".join(picture).replace("\n", "")
    return [f'```{{raw}} html\n<p><img alt="Output of the cell above" src="data:image/png;base64,{data}"/></p>\n```']


def _fenced(language: str, text: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_source_suffix(".ipynb", "ipynb")
    app.add_source_parser(NotebookParser)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
