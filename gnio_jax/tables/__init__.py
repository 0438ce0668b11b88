"""The paper's tables, made anew: networks side by side, what each part contributes, and what
happens at rest."""
