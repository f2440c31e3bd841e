"""The live page: an application over reports and the readers of stores; nothing but the command line imports it."""
