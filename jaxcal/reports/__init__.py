"""What people look at: pages, pictures, budgets. Loaded where one is asked for."""
