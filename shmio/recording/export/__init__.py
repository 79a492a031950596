"""Export recordings for other programs: tables, and MCAP with JSON for viewers."""
