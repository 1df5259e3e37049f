"""Reports of a study: figures, tables, claims of the paper, and a summary for other programs."""
