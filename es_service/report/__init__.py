"""Run store -> data -> figures -> pages: what a run found, as one HTML file, and as figures for a paper."""
