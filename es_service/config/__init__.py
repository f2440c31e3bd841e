"""YAML and overrides -> a validated, fully resolved `RunConfig` (`loading.py` in, `model.py` out)."""
