"""Visual FastSLAM for one robot or a team, without any simulator or learner."""
