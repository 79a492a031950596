"""``[mqtt]`` of ``supervisor.toml``: its keys, their rules, TLS and accounts."""
