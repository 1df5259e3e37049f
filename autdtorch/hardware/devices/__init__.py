"""The devices that a link can drive, a module each; `kinds` lists them."""
