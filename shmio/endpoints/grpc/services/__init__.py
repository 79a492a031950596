"""SimlogAPI versions 1 and 2 with their values and injections, SimServerAPI, and the table of all services."""
