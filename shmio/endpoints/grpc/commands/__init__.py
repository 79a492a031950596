"""Commands to a block's source: values sent, outcomes returned, and the events about both."""
