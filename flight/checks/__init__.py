"""What `fly check` judges: each module turns values somebody else read into lines of the table."""
