"""From declarations to registers with offsets, by Siemens' placement rules."""
