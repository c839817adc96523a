"""The detector that comes with the package: a small network trained on rendered cars (docs/detector.md)."""
