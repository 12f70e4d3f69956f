"""`python -m weather_aug.cli`, the same as the program `weather-aug`."""

from weather_aug.cli import main

main()
