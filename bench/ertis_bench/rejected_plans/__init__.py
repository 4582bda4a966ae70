"""Parts of plans that were rejected, and their counts and errors."""
