"""What laws, plants and training cost; laws compared."""
