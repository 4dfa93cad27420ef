# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation site. Build it with script/site; rosdoc2 reads this file, too."""

import re
import sys
from pathlib import Path

# For the reference of the library; rosdoc2 executes this file elsewhere, and sets the path itself.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

project = 'cliploc_ros'
author = 'the cliploc_ros authors'
copyright = '2026 the cliploc_ros authors'
release = version = '0.2.0'

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx_rtd_theme']
root_doc = 'index'

# The anchors of GitHub, so that one link works in both places.
myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence']
# Indented blocks are shell commands, YAML or XML: not to be coloured as Python.
highlight_language = 'none'

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings have shapes and units, too
napoleon_google_docstring = False

html_theme = 'sphinx_rtd_theme'
html_theme_options = {'navigation_depth': 3, 'titles_only': False}
html_static_path = ['_static']
html_css_files = ['site.css']
html_title = f'cliploc_ros {release}'
html_show_sourcelink = False


def setup(app):
    """Name files outside of doc/ instead of linking to them: the site does not have them."""
    app.connect('source-read', lambda app, page, source: source.__setitem__(0, re.sub(
        r'\[([^\]]+)\]\(\.\./([^)#]+)[^)]*\)', r'\1 (`\2` in the repository)', source[0])))
