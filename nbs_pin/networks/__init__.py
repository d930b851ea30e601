"""Neural networks with structure; torch only, and no knowledge of robots."""
