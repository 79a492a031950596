"""Code generated from ``proto/`` by ``scripts/generate-wire``; nothing here is written by hand."""
