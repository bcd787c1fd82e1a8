# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation site: ``make docs``."""

import piezo_ident

project = 'piezo_ident'
author = 'The piezo_ident authors'
copyright = '2026, The piezo_ident authors'  # noqa: A001
version = release = piezo_ident.__version__

extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.autosummary',
    'sphinx.ext.napoleon',
    'sphinx_copybutton',
    'sphinx_design',
]
exclude_patterns = ['reliability']

myst_enable_extensions = ['attrs_inline', 'colon_fence', 'deflist']
myst_heading_anchors = 3
copybutton_prompt_text = '$ '

# single backticks of the docstrings: a link to a public name, else emphasis
default_role = 'autolink'
napoleon_google_docstring = False
napoleon_use_rtype = False
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings say it with units and shapes
autodoc_default_options = {'members': True}

html_theme = 'pydata_sphinx_theme'
html_title = 'piezo_ident'
html_static_path = ['static']
html_css_files = ['site.css']
html_show_sourcelink = False
html_theme_options = {
    'navigation_with_keys': False,
    'show_toc_level': 2,
    'header_links_before_dropdown': 6,
    'secondary_sidebar_items': ['page-toc'],
}
