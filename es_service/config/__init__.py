"""The config of a run: `loading.py` turns YAML and overrides into the validated, resolved `RunConfig` of `model.py`."""
