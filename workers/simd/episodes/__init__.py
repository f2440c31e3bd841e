"""What the other folders serve: functions of many environments at once, and whole episodes with policy and noise."""
