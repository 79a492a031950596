"""Read recordings: closed ones, those of a killed recorder, and those being written."""
