function tune() { throw new Error("no tuner yet"); }
