"""What the driver's side and the workers' side both import: messages, noise, processes. It imports nothing of ours."""
