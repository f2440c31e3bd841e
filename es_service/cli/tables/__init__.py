"""What the commands print: tables and lines."""
