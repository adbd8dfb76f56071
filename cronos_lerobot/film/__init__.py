"""Drawing and encoding of pictures and videos."""
