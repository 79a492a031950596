"""The section ``[mqtt]`` of ``supervisor.toml``: keys, rules, TLS files and accounts."""
