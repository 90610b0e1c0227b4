"""The plugin: what nerfstudio trains, loads and shows."""
