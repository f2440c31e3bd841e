"""Code that runs in workers: tasks, policy and compiled episodes. Of es_service it imports only the protocol."""
