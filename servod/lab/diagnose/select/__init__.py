"""Selection of effects: candidates, fits, forward selection, backward elimination, swap."""
