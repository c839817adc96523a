"""The paper's tables measured anew, and how any table is written."""
