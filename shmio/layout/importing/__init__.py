"""Converts tag lists of engineering tools to tag tables.

The tools are TIA Portal, STEP 7 and KEPServerEX; OPC UA node sets of any tool are read too. Each
format has a module.
"""
