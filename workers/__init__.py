"""What runs where the rollouts run: tasks, policy, compiled episodes. Of es_service it imports protocol and noise."""
