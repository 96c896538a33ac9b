"""PPO inside the graph, the networks it trains, and the policies it is compared with."""
