"""Tables in text files: their encoding and layout found or given, their headings, units and numbers."""
