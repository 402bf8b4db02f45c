"""Sphinx: pages in MyST Markdown, their code cells executed at each build, the API from the docstrings."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from gbid._version import __version__  # noqa: E402

# The cells run in a kernel of their own, which inherits these.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("PYTHONPATH", str(HERE.parent))
os.environ["NO_COLOR"] = "1"
os.environ["COLUMNS"] = "120"
os.environ["JUPYTER_PREFER_ENV_PATH"] = "1"  # the kernel of this environment, not one installed elsewhere
os.environ["JUPYTER_PLATFORM_DIRS"] = "1"
os.environ["PYDEVD_DISABLE_FILE_VALIDATION"] = "1"  # the debugger that comes with the kernel is not used

project = "gbid"
author = "The gbid developers"
project_copyright = "The gbid developers"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx_copybutton"]
# MathJax with its letters and extensions in one file, from a package: formulas need no network.
_MATHJAX = Path(str(find_spec("sphinx-mathjax-offline").origin)).parent / "static" / "mathjax" / "tex-svg-full.js"
html_static_path = [str(_MATHJAX)]
mathjax_path = _MATHJAX.name
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = False
copybutton_selector = "div.highlight:not(.cell_output *) pre"
exclude_patterns = ["_build", "jupyter_execute"]
source_suffix = {".md": "myst-nb"}

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 120
nb_execution_show_tb = True  # a failing cell is a warning, which the build makes an error
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give type, shape and unit
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
default_role = "py:obj"

html_theme = "furo"
html_title = f"gbid {version}"
html_copy_source = False
html_show_sphinx = False


def executed_pages(_app: Any, env: Any, *_changes: set[str]) -> list[str]:
    """Pages with code cells are built each time: what they show depends on the code, not on their text alone."""
    return [name for name in env.found_docs if "{code-cell}" in Path(env.doc2path(name)).read_text(encoding="utf-8")]


def setup(app: Any) -> None:
    """Connect to the build."""
    app.connect("env-get-outdated", executed_pages)
