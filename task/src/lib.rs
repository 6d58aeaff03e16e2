//! The Markov decision process: observation, action filter, rewards, commands, episodes, randomisation, pushes.
