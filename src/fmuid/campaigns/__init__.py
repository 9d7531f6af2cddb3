"""Campaign files: read and checked, held against their models, and begun from recorded runs."""
