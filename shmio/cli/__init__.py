"""The command-line tools: a thin layer over the library. The library never imports them."""
