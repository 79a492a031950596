"""Read the text of sources into declarations, with a lexer and a parser."""
