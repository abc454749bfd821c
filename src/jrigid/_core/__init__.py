"""Parts on which every other package of jrigid builds."""
