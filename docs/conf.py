"""The site of the documentation: `make docs`. Pages lie where they belong in the repository."""

project = "jaxtrack"
extensions = ["myst_parser"]
root_doc = "docs/index"
include_patterns = ["docs/**.md", "README.md", "[a-z]*/README.md", "CHANGELOG.md"]
exclude_patterns = [".*", "runs", "bench", "build"]
myst_heading_anchors = 3
html_theme = "alabaster"
html_theme_options = {"description": "Radar search and track in pure JAX", "page_width": "1100px"}
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False
