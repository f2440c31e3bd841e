"""What runs where the rollouts run: tasks, policy, compiled episodes. Imports of es_service: protocol and noise only."""
