"""SimlogAPI versions 1 and 2, SimServerAPI, and the table of all services."""
