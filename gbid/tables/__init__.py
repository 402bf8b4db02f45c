"""Tables: one value of columns and rows, and its renderers for terminal, HTML, Markdown and CSV."""
