"""Files: model.json, setups, URDF."""
