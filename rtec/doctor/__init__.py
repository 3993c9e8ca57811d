"""Are the devices well, and is this computer fit for real time?"""
