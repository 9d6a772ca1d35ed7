"""The article's comparison again: PPO and PPO-LSTM from several seeds, its Table 2 and figures 4 to 9, theirs beside ours."""
