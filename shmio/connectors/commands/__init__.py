"""Commands toward a source: judged, batched and carried out with the next cycle."""
