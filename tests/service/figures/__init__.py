"""What the service holds, measured: ``make service-figures``."""
