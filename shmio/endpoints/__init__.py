"""Endpoints: the processes that give remote programs access to an instance's shared memory."""
