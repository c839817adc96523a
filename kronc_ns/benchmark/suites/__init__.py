"""What `kronc bench` measures: rows of figures over seeds, beside what is asked of them."""
