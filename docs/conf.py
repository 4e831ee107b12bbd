"""How the documents are built: `sphinx-build -W docs docs/_build`."""

import os
import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).parent))

project = "prefrl"
author = "the prefrl authors"
copyright = "2026, the prefrl authors"
version = release = installed("prefrl")
extensions = ["myst_parser", "sphinx.ext.autodoc", "reference"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
add_module_names = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("Floats", "Integers", "Bools", "Metrics", "Json", "Fields", "State")}
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "prefrl"
html_show_sphinx = False
