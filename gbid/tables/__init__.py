"""Tables: values in columns and rows, and renderers for terminal, HTML, Markdown and CSV."""
