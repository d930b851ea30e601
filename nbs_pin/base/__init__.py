"""What every room uses: errors, arrays, checks, files and records."""
