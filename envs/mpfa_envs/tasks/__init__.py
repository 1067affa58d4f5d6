"""Start, goal and reward, and the sets of tasks that policies are compared on."""
