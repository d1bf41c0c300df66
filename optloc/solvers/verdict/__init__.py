"""The verdict: from refined candidates to a fix with a status."""
