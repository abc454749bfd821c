"""What every other package of jrigid builds on."""
