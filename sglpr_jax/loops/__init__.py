"""Loop closures: retrieval, verification and relative poses, for streams, recordings and saved maps."""
