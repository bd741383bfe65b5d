def voxels(job, grids): raise NotImplementedError
