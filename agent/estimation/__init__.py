"""Estimators: Gaussian algebra, transforms, models, covariance intersection, co-localization."""
