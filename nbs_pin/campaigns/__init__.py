"""Many jobs in one call: the runner that saves, resumes and shares them; plans of closed-loop runs and their table."""
