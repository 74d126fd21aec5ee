"""Settings of the documentation: ``python -m sphinx -W -b html docs OUT``. Nothing is fetched, and no scene is rendered."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import shadowmap_dr  # noqa: E402

project = "shadowmap_dr"
author = "The shadowmap_dr developers"
copyright = author
version = release = shadowmap_dr.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "myst_parser",
    "docstrings",
    "generated",
    "notebooks",
    "project_links",
]
exclude_patterns = ["_ext", "_build"]
default_role = "py:obj"
# Dashes only: quotation marks stay as they are.
smartquotes_action = "D"

myst_heading_anchors = 3
# Included pages may begin with any heading. Dr.Jit and PyTorch have records of the same names, such as Topology.
suppress_warnings = ["myst.header", "ref.python"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
# Names of arrays: at run time all of them are Any.
_TYPES = (HERE.parent / "shadowmap_dr" / "jit" / "types.py").read_text(encoding="utf-8")
autodoc_type_aliases = {name: name for name in re.findall(r"^    (\w+): TypeAlias", _TYPES, re.MULTILINE)}
autodoc_mock_imports = [] if importlib.util.find_spec("torch") else ["torch"]
python_use_unqualified_type_names = True
maximum_signature_line_length = 80
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = f"shadowmap_dr {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_copyright = False
html_copy_source = False
copybutton_prompt_text = "$ "
