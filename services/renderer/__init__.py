"""The process that draws: novel views, scenes, exports, figures. The API starts it; it alone loads the numeric core."""
