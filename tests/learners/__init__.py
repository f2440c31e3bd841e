"""Tests with reinforcement learners of others, which run where these are installed; `environment` installs them."""
