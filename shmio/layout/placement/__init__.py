"""Place declarations: give each register its offset, by Siemens' placement rules."""
