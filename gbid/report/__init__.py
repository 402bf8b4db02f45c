"""Tables and figures: a result in, a table or axes out."""
