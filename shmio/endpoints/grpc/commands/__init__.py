"""Commands to a block's source: sends values, returns outcomes, and passes on the events."""
