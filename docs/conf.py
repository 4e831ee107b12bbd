"""How the documents are built: `sphinx-build -W docs docs/_build`."""

from importlib.metadata import version as installed

project = "prefrl"
author = "the prefrl authors"
copyright = "2026, the prefrl authors"
version = release = installed("prefrl")
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "prefrl"
html_show_sphinx = False
