"""How close each way of choosing postures comes to the proven optimum."""
