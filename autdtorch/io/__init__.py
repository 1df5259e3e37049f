"""Files of scenes, arrays, drives and fields."""
