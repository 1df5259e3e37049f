"""Files: scenes in YAML, arrays, drives and fields."""
