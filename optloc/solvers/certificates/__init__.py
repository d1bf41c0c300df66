"""What is proven of a fix, and how."""
