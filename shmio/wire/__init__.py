"""Code that ``scripts/generate-wire`` generates from ``proto/``. Do not change it by hand."""
