"""From source text to declarations: lexer, parser, constants."""
