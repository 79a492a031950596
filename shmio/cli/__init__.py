"""The commands: thin over the library, imported by nothing."""
