"""Commands: one module each, with little code beside calls of the library."""
