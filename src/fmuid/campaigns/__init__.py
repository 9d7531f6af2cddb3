"""Campaign files: reading, checking, and creating them from recorded runs."""
