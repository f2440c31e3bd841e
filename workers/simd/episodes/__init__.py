"""Compiled functions of many environments at once, and compiled whole episodes with policy and noise."""
