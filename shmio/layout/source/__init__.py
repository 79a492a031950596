"""Read source text into declarations: lexer, parser, constants."""
