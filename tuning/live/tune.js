function tune() { throw new Error("stub"); }
