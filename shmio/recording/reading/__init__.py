"""Reading recordings: whole ones, those of a killed recorder, and those being written."""
