"""The command-line tools: a thin layer over the library, which never imports them."""
